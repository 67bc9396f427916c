"""Answers folded by robot, and the verbs that read a policy for a fleet."""

from __future__ import annotations

import json
from itertools import permutations, product
from pathlib import Path

import pytest

from sros_tool.checks.formats import folded_findings
from sros_tool.checks.requirements import VIOLATED
from sros_tool.cli.changed import print_plan
from sros_tool.fleet.robots import Fleet, Robot, folded_lines
from sros_tool.keystore import transaction
from tests.proof.test_review import Change
from tests.support.harness import copy_of, policy_text, publish, sros, subscribe

FLEET = Fleet.of(
    [
        Robot("r1", "/hall/r1", groups=("carriers",)),
        Robot("r10", "/hall/r10", groups=("carriers",)),
        Robot("r2", "/r2"),
        Robot("x", "/"),
    ],
    enclaves=["/{robot}/base"],
)


def lines(text: str, *robots: str) -> list[tuple[str, str]]:
    spaces = {name: robot.namespace.rstrip("/") for name, robot in FLEET.robots.items()}
    return [(f"/{name}/base", text.format(robot=name, namespace=spaces[name])) for name in robots]


def test_what_differs_only_in_the_robot_is_one_line() -> None:
    text = "- /{robot}/base ALLOW publish topic {namespace}/odom"
    assert list(folded_lines(FLEET, lines(text, "r1", "r10", "r2"))) == [
        f"{text}  (3 robots: r1, r10, r2)"
    ]
    assert list(folded_lines(FLEET, lines(text, "r1", "r10"))) == [
        f"{text}  (the 2 robots of carriers)"
    ]
    every = "/{robot}/base"
    assert list(folded_lines(FLEET, lines(every, *FLEET.robots))) == [f"{every}  (all 4 robots)"]


def test_what_differs_stands_out_and_one_robot_stays_as_it_is() -> None:
    found = [*lines("/{robot}/base may", "r1", "r10"), *lines("/{robot}/base may not", "r2"),
             ("/d", "/d may")]  # fmt: skip
    assert list(folded_lines(FLEET, found)) == [
        "/{robot}/base may  (the 2 robots of carriers)", "/r2/base may not", "/d may",
    ]  # fmt: skip
    assert list(folded_lines(None, found)) == [text for _, text in found]


def test_the_name_of_another_robot_is_no_placeholder() -> None:
    found = [("/r1/base", "/r1/base to /r10/x r1_x"), ("/r10/base", "/r10/base to /r10/x r1_x")]
    assert list(folded_lines(FLEET, found)) == [text for _, text in found]


def test_an_enclave_of_no_robot_has_the_only_robot_that_its_line_names() -> None:
    one = [("/d", f"/d may publish {names}/go") for names in ("/hall/r1", "/hall/r10", "/r2")]
    assert list(folded_lines(FLEET, one)) == [
        "/d may publish {namespace}/go  (3 robots: r1, r10, r2)",
    ]
    several = [("/d", f"/d may move {names}") for names in ("/r1 to /r2", "/r2 to /r1")]
    assert list(folded_lines(FLEET, several)) == [text for _, text in several]


def test_an_enclave_of_a_robot_is_folded_by_the_only_other_robot_of_its_lines() -> None:
    one = [("/x/base", f"/x/base may publish {names}/go") for names in ("/hall/r1", "/hall/r10")]
    assert list(folded_lines(FLEET, one)) == [
        "/x/base may publish /hall/{other}/go  (the 2 robots of carriers)"
    ]
    every = [*one, ("/x/base", "/x/base may publish /r2/go"), ("/x/base", "/x/base may join")]
    assert list(folded_lines(FLEET, every)) == [
        "/x/base may publish /hall/{other}/go  (the 2 robots of carriers)",
        "/x/base may publish /r2/go", "/x/base may join",
    ]  # fmt: skip
    both = [*one, ("/r2/base", "/r2/base may publish /hall/r1/go")]
    assert list(folded_lines(FLEET, both)) == [
        "/{robot}/base may publish /hall/r1/go  (2 robots: x, r2)",
        "/x/base may publish /hall/r10/go",
    ]


def test_many_lines_that_differ_in_two_robots_are_one() -> None:
    names = [f"r{number}" for number in range(8)]
    fleet = Fleet.of([Robot(name, f"/{name}") for name in names], enclaves=["/{robot}/base"])
    every = [(a, b) for a in names for b in names if a != b]

    def told(pairs: list[tuple[str, str]]) -> list[str]:
        lines = ((f"/{one}/base", f"/{one}/base publish /{other}/go") for one, other in pairs)
        return list(folded_lines(fleet, lines))

    text = "/{robot}/base publish /{other}/go  "
    assert told(every) == [f"{text}(all 8 robots, each with every other)"]
    assert told(every[1:]) == [f"{text}(55 pairs of robots, such as r0 and r2)"]
    to_two = [pair for pair in every if pair[1] in ("r6", "r7")]
    assert len(told(to_two)) == 2


APART = """\
[[apart]]
from = ["/{robots}/*", "!/{robot}/*"]
to = ["/{robot}/*"]
"""


def test_pairs_are_said_to_be_all_only_if_they_are_all() -> None:
    sources, targets = ([f"{letter}{n}" for n in range(7)] for letter in "ab")
    robots = [Robot(name, f"/{name}") for name in (*sources, *targets)]
    fleet = Fleet.of(robots, enclaves=["/{robot}/x"])

    def told(pairs: list[tuple[str, str]]) -> list[str]:
        return list(
            folded_lines(fleet, [(f"/{one}/x", f"/{one}/x to /{two}/y") for one, two in pairs])
        )

    each_other = told([*permutations(sources, 2)])
    (line,) = each_other
    assert line.endswith("a6, each with every other)")
    # As many pairs as of seven robots with each other, but with other robots.
    every = [*product(sources, targets[1:])]
    (line,) = told([*every[:-1], ("a6", "b0")])
    assert line == "/{robot}/x to /{other}/y  (42 pairs of robots, such as a0 and b1)"
    (line,) = told(every)
    assert line.endswith("a6, each with 6 robots: b1, b2, b3, b4, b5, b6)")
    # Over robots that pass it on; a line with more other robots is about too much to be folded.
    for via, is_folded in ("b0", True), ("b0 to /b1/z to /b2", False):
        path = f"to /{via}/z to"
        passed_on = [(f"/{a}/x", f"/{a}/x {path} /{b}/y") for a, b in permutations(sources, 2)]
        folded = list(folded_lines(fleet, passed_on))
        every_other = each_other[0].partition("  ")[2]
        assert (folded == [f"/{{robot}}/x {path} /{{other}}/y  {every_other}"]) == is_folded
    few = [*product(sources[:2], targets[:2])]
    assert told(few) == ["/{robot}/x to /{other}/y  (2 robots: a0, a1, each with 2 robots: b0, b1)"]
    assert len(told(few[1:])) == 2


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("folding")
    wide = policy_text({"/{robot}/base": publish("{namespace}/odom"), "/d": publish("{robots}/go")})
    (folder / "p.xml").write_text(wide)
    (folder / "f.toml").write_text("[robots]\nr1 = {}\nr2 = {}\nr3 = {}\n")
    (folder / "g.toml").write_text(
        '[robots]\nr1 = {}\nr2 = {namespace = "/b", renewal = "allowed"}\n'
    )
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", "--fleet", "f.toml", cwd=folder).ok()
    return folder


def test_two_fleets_are_compared(made: Path) -> None:
    same = sros("diff_policy", "p.xml", "ks", "--fleet", "f.toml", cwd=made).ok()
    assert same.out == ""
    ended = sros(
        "diff_policy", "p.xml", "p.xml", "--fleet", "f.toml", "--fleet", "g.toml", cwd=made
    )
    assert ended.status == 1
    assert ended.out.splitlines() == [
        "- /d ALLOW publish topic /r3/go",
        "- /{robot}/base ALLOW publish topic {namespace}/odom  (2 robots: r2, r3)",
        "+ /r2/base ALLOW publish topic /b/odom",
    ]
    renewal = "[fleet.renewal]: r2 may now request renewal (renewal: refused -> allowed)"
    assert renewal in ended.err
    words = ("diff_policy", "--no-new-access", "p.xml", "p.xml", "--fleet", "f.toml")
    assert renewal in sros(*words, "--fleet", "g.toml", cwd=made).err


def test_what_a_change_takes_away_is_folded(made: Path) -> None:
    text = (made / "p.xml").read_text()
    (made / "less.xml").write_text(text.replace("/go<", "/gone<").replace("/odom<", "/odometry<"))
    words = ("generate_artifacts", "-k", "ks", "-p", "less.xml", "--fleet", "f.toml", "--dry-run")
    ended = sros(*words, cwd=made).ok()
    said = ended.err.splitlines()
    assert set(said[:4]) == {
        "/d would lose: publish topic {namespace}/go  (all 3 robots)",
        "/d would gain: publish topic {namespace}/gone  (all 3 robots)",
        "/{robot}/base would lose: publish topic {namespace}/odom  (all 3 robots)",
        "/{robot}/base would gain: publish topic {namespace}/odometry  (all 3 robots)",
    }
    assert "would replace ks/enclaves/{robot}/base/permissions.p7s  (all 3 robots)" in ended.out
    assert "a program that still uses a lost right may fail to start" in said[4]
    assert "base and 1 more: the rights that they lost still" in said[5]
    assert "`sros renew ks ENCLAVE... --revoke-old`" in said[5]
    planned = sros("revoke", "ks", "--match", "/r*", "--dry-run", cwd=made).ok().out
    assert planned.startswith("would revoke enclave /{robot}/base  (all 3 robots)\nwould ")


def test_a_robot_in_another_domain_is_a_difference(made: Path) -> None:
    for name, domains in (("here.toml", (1, 1, 1)), ("moved.toml", (1, 7, 7))):
        robots = (f"r{number} = {{domain = {of}}}" for number, of in enumerate(domains, 1))
        (made / name).write_text("\n".join(("[robots]", *robots)))
    words = ("diff_policy", "p.xml", "p.xml", "--fleet", "here.toml", "--fleet")
    assert sros(*words, "here.toml", cwd=made).ok().out == ""
    moved = sros(*words, "moved.toml", cwd=made)
    assert moved.status == 1 and moved.err.strip() == "the ROS domains of 2 enclaves differ"
    assert moved.out.splitlines() == [
        "- /{robot}/base in domain 1  (2 robots: r2, r3)",
        "+ /{robot}/base in domain 7  (2 robots: r2, r3)",
    ]
    found = json.loads(sros(*words, "moved.toml", "--json", cwd=made).out)
    assert not found["equal"]
    assert found["domains"][0] == {"enclave": "/r2/base", "a": "1", "b": "7"}
    words = ("check", "ks", "--policy", "p.xml", "--include", "enclave.stale-permissions")
    sros(*words, cwd=made).ok()  # its own fleet fills in the placeholders
    drift = sros(*words, "--fleet", "moved.toml", cwd=made)
    assert drift.status == 1 and "r2 in domain 7, but the permissions are for domain 0" in drift.out


def test_findings_that_also_differ_in_other_robots_are_one_if_they_are_many() -> None:
    names = [f"r{number}" for number in range(8)]
    fleet = Fleet.of([Robot(name, f"/{name}") for name in names])

    def told(pairs: list[tuple[str, str]]) -> list[str]:
        found = ((VIOLATED.found(f"/{a}/nav", f"may publish /{b}/go"),) for a, b in pairs)
        return [f"{group[0].subject} {others}" for group, others in folded_findings(found, fleet)]

    assert told([("r0", name) for name in names[1:]]) == [
        "/r0/nav the same for 6 more robots: r2, r3, r4, r5, r6, r7"
    ]
    assert told([("r1", "r2"), ("r3", "r4")]) == ["/r1/nav ", "/r3/nav "]
    assert told([*zip(names, names[1:] + names[:1], strict=True)]) == [
        "/r0/nav similar for 7 more robots (with other names): r1, r2, r3, r4, r5, r6, r7"
    ]


def test_findings_on_several_enclaves_of_each_robot_are_one() -> None:
    """But not if one of the enclaves has no finding on one of the robots."""
    robots = [f"r{number}" for number in range(13)]
    fleet = Fleet.of([Robot(name, f"/{name}") for name in robots])
    pairs = [(robot, part) for part in ("a", "b", "c") for robot in robots]

    def told(chosen: list[tuple[str, str]]) -> list[str]:
        found = ((VIOLATED.found(f"/{r}/{part}", f"/{r}/{part} may not"),) for r, part in chosen)
        return [f"{group[0].subject} {others}" for group, others in folded_findings(found, fleet)]

    (text,) = told(pairs)
    assert text.startswith("/r0/a the same for 12 more robots: r1, ")
    assert text.endswith("and 2 more; the same for 2 more enclaves of each robot: /r0/b, /r0/c")
    assert len(told([pair for pair in pairs if pair not in {("r11", "a"), ("r12", "b")}])) == 3


def test_a_review_is_folded(tmp_path: Path) -> None:
    change = Change(tmp_path)
    wide = policy_text(
        {"/{robot}/nav": publish("{namespace}/go"), "/{robot}/base": subscribe("{namespace}/go")}
    ).replace('ns="/"', 'ns="{namespace}"')
    wide = wide.replace('node="n"', 'node="m"', 1)
    robots = "".join(f"r{number} = {{}}\n" for number in range(6))
    files = {"fleet.toml": f"[robots]\n{robots}", "r.toml": APART}
    change.commit({"p.xml": wide.replace("{namespace}/go", "go"), **files})
    change.commit({"p.xml": wide.replace("{namespace}/go", "{namespaces}/go", 1)})
    words = ("--policy", "p.xml", "--fleet", "fleet.toml", "--requirements", "r.toml")
    ended = change.review(*words, "--summary", str(tmp_path.parent / "review.md"))
    each = "(all 6 robots, each with every other)"
    for text in (ended.out, (tmp_path.parent / "review.md").read_text()):
        assert each in text and "/{robot}/nav publish topic /{other}/go" in text
        assert text.count("influences /r") == 2, text
        assert "the same for 4 more robots: r2, r3, r4, r5" in text
        assert "begins with / now, so" not in text, "the namespaces of the robots are known"
    assert len(ended.out.splitlines()) == 18, ended.out


def test_many_files_of_a_plan_are_counted(capsys: pytest.CaptureFixture[str]) -> None:
    plan = [transaction.Change("create", f"enclaves/e{number}/key.pem") for number in range(21)]
    print_plan(Path("ks"), plan)
    first = ", ".join(f"ks/{change.path}" for change in plan[:5])
    said = f"would create 21 files: {first} and 16 more (-v lists all)\n"
    assert capsys.readouterr().out == said
    print_plan(Path("ks"), plan[:20])
    assert len(capsys.readouterr().out.splitlines()) == 20


def test_an_exported_enclave_of_a_fleet_is_exported_again(made: Path) -> None:
    sros("distribute_key", "ks", "/r1/base", "out", cwd=made).ok()
    words = ("explain", "out", "/r1/base", "publish", "/no", "--policy", "p.xml")
    said = sros(*words, "--fleet", "f.toml", cwd=made).out.splitlines()
    assert said[-2].endswith("sros generate_artifacts -k KEYSTORE -p p.xml --fleet FLEET_FILE")
    assert said[-1].strip() == "sros distribute_key KEYSTORE /r1/base TARGET --force"


def test_a_damaged_fleet_is_a_finding_also_next_to_a_policy(made: Path, tmp_path: Path) -> None:
    ks, policy = copy_of(made / "ks", tmp_path / "ks"), tmp_path / "d.xml"
    (ks / "fleet.toml").write_text("[robots")
    policy.write_text(policy_text({"/d": publish("/go")}))
    ended = sros("check", ks, "--policy", policy)
    assert ended.status == 1 and "fleet.toml" in ended.out


def test_who_and_reach_are_folded(made: Path) -> None:
    said = sros("explain", "ks", "--who", "join", cwd=made).ok().out
    assert said.splitlines() == [
        "/d",
        "/{robot}/base  (all 3 robots)",
        "4 of 4 enclaves may join the domain",
    ]
    one = sros("explain", "ks", "--who", "join", "--robot", "r2", cwd=made).ok().out
    assert one.splitlines() == ["/r2/base", "1 of 1 enclave may join the domain"]
    found = json.loads(sros("explain", "ks", "--who", "join", "--json", cwd=made).out)
    assert [each["enclave"] for each in found["enclaves"]] == [
        "/d",
        "/r1/base",
        "/r2/base",
        "/r3/base",
    ]


def test_check_and_view_read_a_policy_for_a_fleet(made: Path) -> None:
    without = sros("check", "p.xml", cwd=made)
    assert "has a placeholder" in without.out and without.status == 1
    found = sros("check", "p.xml", "--fleet", "f.toml", "--json", cwd=made)
    assert {each["subject"] for each in json.loads(found.out)["findings"]} >= {
        "/r1/base",
        "/r3/base",
    }
    assert "placeholder" not in found.out
    drawn = sros("view", "p.xml", "--fleet", "f.toml", "--format", "mermaid", cwd=made).ok().out
    of_keystore = sros("view", "ks", "--format", "mermaid", cwd=made).ok().out
    assert "3 equal robots are drawn as one" in drawn
    assert "3 equal robots are drawn as one" in of_keystore


def test_findings_that_differ_only_in_their_enclave_are_one_if_they_are_three() -> None:
    def told(*pairs: tuple[str, str]) -> list[str]:
        found = ((VIOLATED.found(a, text.format(a), f"ks/enclaves{a}"),) for a, text in pairs)
        return [f"{group[0].subject} {others}" for group, others in folded_findings(found, None)]

    same = [(enclave, "{} may publish /go") for enclave in ("/a", "/b", "/c")]
    assert told(*same) == ["/a the same for 2 more enclaves: /b, /c"]
    assert told(*same[:2]) == ["/a ", "/b "]
    assert told(*same[:2], ("/c", "{} may publish /stop")) == ["/a ", "/b ", "/c "]
