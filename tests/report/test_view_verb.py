"""The verb: which sources make which picture, and what it refuses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.report.pictures import MOBILE_ROBOT, group
from tests.support.harness import policy_text, sros
from tests.support.long_form import some

pytest_plugins = ["tests.report.browsing"]


def write(folder: Path, name: str, *names: str) -> Path:
    path = folder / name
    path.write_text(policy_text({"/a": group("topics", "publish", *names)}))
    return path


def value(*arguments: object) -> dict[str, Any]:
    found = json.loads(sros("view", *arguments, "--format", "json").ok().out)
    assert isinstance(found, dict)
    return found


def test_what_is_laid_over_what_is_seen_from_the_sources(
    tmp_path: Path, robot_keystore: Path
) -> None:
    old, new = write(tmp_path, "old.xml", "/x"), write(tmp_path, "new.xml", "/y")
    assert value(old)["overlay"] is None
    assert value(old, new)["overlay"]["kind"] == "change"
    assert value(old, "--observed", new, new)["overlay"]["kind"] == "use"
    drift = value(robot_keystore, MOBILE_ROBOT)
    assert drift["overlay"] == {
        "kind": "drift",
        "first": "only in the policy",
        "second": "only in what was signed",
    }
    assert [origin["kind"] for origin in drift["origins"]] == ["policy", "keystore"]
    assert {d["text"].split()[0] for d in drift["differences"]} <= {"/spare"}


def test_drift_shows_what_was_never_signed(tmp_path: Path, keystore: Path) -> None:
    policy = tmp_path / "robot.xml"
    policy.write_text(
        policy_text({name: group("topics", "publish", f"/old{name[1:]}") for name in ("/a", "/b")})
    )
    policy.write_text(policy.read_text().replace("/oldb", "/new_b").replace("/olda", "/old_a"))
    drift = value(policy, keystore)
    assert [(d["mark"], d["text"]) for d in drift["differences"]] == [
        ("first", "/b ALLOW publish topic /new_b"),
        ("second", "/b ALLOW publish topic /old_b"),
    ]


def test_an_observation_is_a_source(tmp_path: Path) -> None:
    seen = {
        "file": "x.xml",
        "nodes": [
            {
                "enclaves": ["/a"],
                "namespace": "/",
                "name": "talker",
                "participant": "0" * 24,
                "publish": ["rt/x"],
                "subscribe": [],
            }
        ],
    }
    (tmp_path / "seen.json").write_text(json.dumps(seen))
    alone = value(tmp_path / "seen.json")
    assert [(e["enclave"], e["name"]) for e in alone["edges"]] == [("/a", "/x")]
    assert alone["enclaves"][0]["nodes"] == ["/talker"]
    assert [finding["id"] for finding in alone["findings"]] == ["view.not-checked"]
    assert str(tmp_path) not in alone["findings"][0]["text"]
    policy = write(tmp_path, "robot.xml", "/x", "/y")
    over = value(policy, tmp_path / "seen.json")
    assert over["overlay"]["kind"] == "use"
    assert {e["name"]: e["mark"] for e in over["edges"]} == {"/x": "both", "/y": "first"}


def test_a_folder_of_policies_has_the_findings_of_its_files(tmp_path: Path) -> None:
    policies = tmp_path / "policies"
    policies.mkdir()
    alone = value(write(policies, "p.xml", "/x"))["findings"]
    assert alone and value(policies)["findings"] == alone


def test_a_name_that_begins_like_the_folder_of_the_policy_stays(tmp_path: Path) -> None:
    (policy := tmp_path / "left/arm/p.xml").parent.mkdir(parents=True)
    policy.write_text(policy_text({"/n": ""}).replace('ns="/"', 'ns="/left/arm"'))
    shown = sros("view", "left/arm/p.xml", "--format", "json", cwd=tmp_path).ok().out
    assert "p.xml:1: node /left/arm/n may not publish /rosout" in shown, shown


def test_permissions_alone_are_neither_verified_nor_a_broken_policy(
    robot_keystore: Path, tmp_path: Path
) -> None:
    file, named = tmp_path / "lone.p7s", tmp_path / "permissions.p7s"
    for copy in (file, named):
        copy.write_bytes(next(robot_keystore.glob("enclaves/**/permissions.p7s")).read_bytes())
    assert str(tmp_path) not in str(value(named))
    found = value(file)["findings"]
    assert [finding["id"] for finding in found] == ["rights.not-verified", "view.not-checked"]
    assert "a DDS Security document without its enclave" in found[1]["text"]
    plain = shutil.copy(
        next(robot_keystore.glob("enclaves/**/permissions.xml")), tmp_path / "p.xml"
    )
    for lone in (file, plain):
        checked = sros("check", lone)
        assert checked.status == 2 and "Name the folder of the enclave" in checked.err
    policy = write(tmp_path, "robot.xml", "/x")
    policy.write_text(policy.read_text().replace("<enclaves>", "<!-- see <dds> --><enclaves>", 1))
    assert "[policy." in sros("check", policy).out
    (tmp_path / "permissions_ca.cert.pem").write_bytes(
        (robot_keystore / "public/permissions_ca.cert.pem").read_bytes()
    )
    assert "note [rights." not in sros("view", file, "--format", "markdown").ok().err
    file.write_bytes(file.read_bytes().replace(b"<topic>rt/", b"<topic>rt/x", 1))
    assert "THE SIGNATURE DOES NOT VERIFY" in sros("view", file, "--format", "markdown").ok().err


def test_a_keystore_tells_validity_protection_and_findings(robot_keystore: Path) -> None:
    found = value(robot_keystore)
    kinds = [v["kind"] for v in found["validities"]]
    assert kinds.count("certificate") == kinds.count("permissions") == 13
    assert kinds.count("authority") == 2
    assert kinds.count("revocation list") == 1
    assert [v["not_after"] for v in found["validities"]] == sorted(
        v["not_after"] for v in found["validities"]
    )
    assert {n["protection"]["level"] for n in found["names"]} == {"encrypt"}
    camera = next(e for e in found["enclaves"] if e["path"] == "/mobile_robot/camera")
    assert "CN=/mobile_robot/camera" in camera["subject"]
    assert camera["key"].startswith("EC")
    assert not camera["problems"]
    assert found["revoked"] == ["/spare"]
    for form in ("html", "markdown"):
        drawn = sros("view", robot_keystore, "--format", form).ok().out
        assert drawn.count("evoked, and therefore not drawn: /spare") == 1


@pytest.mark.parametrize("kind", some(["a keystore", "an enclave", "drift", "use"], 2))
def test_a_template_is_refused_where_a_governance_holds(
    robot_keystore: Path, tmp_path: Path, kind: str
) -> None:
    signed = robot_keystore
    if kind == "an enclave":
        signed = robot_keystore / "enclaves/mobile_robot/base"
    words = {"drift": (MOBILE_ROBOT, signed), "use": (signed, "--observed", MOBILE_ROBOT)}
    asked = words.get(kind, (signed,))
    out = tmp_path / "out.json"
    sros("view", *asked, "-o", out).ok()
    out.unlink()
    refused = sros("view", *asked, "--template", "production", "-o", out)
    assert (refused.status, refused.out, out.exists()) == (2, "", False)
    article = kind if kind.startswith("an ") else "a keystore"
    assert f"--template does not fit '{signed}'" in refused.err
    assert f"It is {article}, which is drawn with its own governance" in refused.err
    assert "Leave --template out" in refused.err


def test_a_template_protects_policies(tmp_path: Path) -> None:
    policy = write(tmp_path, "robot.xml", "/x")
    assert value(policy)["names"][0]["protection"]["level"] == "unknown"
    shown = value(policy, "--template", "production")
    assert shown["names"][0]["protection"]["level"] == "encrypt"


def test_hosts_group_enclaves(tmp_path: Path) -> None:
    policy = write(tmp_path, "robot.xml", "/x")
    assert value(policy, "--host", "arm=/a")["enclaves"][0]["group"] == "arm"
    assert sros("view", policy, "--host", "arm").status == 2


def test_the_ending_of_the_file_says_the_format(tmp_path: Path) -> None:
    policy = write(tmp_path, "robot.xml", "/x")
    for name, begins in (
        ("a.svg", "<svg"),
        ("a.dot", "digraph"),
        ("a.mmd", "---"),
        ("a.html", "<!doctype"),
        ("page", "<!doctype"),
        ("a.json", "{"),
    ):
        ended = sros("view", policy, "-o", tmp_path / name).ok()
        assert ended.err == f"wrote '{tmp_path / name}'\n"
        assert (tmp_path / name).read_text().startswith(begins), name


def test_a_name_of_another_format_is_refused(tmp_path: Path) -> None:
    policy = write(tmp_path, "robot.xml", "/x")
    for form in (("--json",), ("--format", "html")):
        ended = sros("view", policy, *form, "-o", tmp_path / "a.svg")
        named = tmp_path / f"a.{form[-1].removeprefix('--')}"
        assert (ended.status, f"Name it '{named}'" in ended.err) == (2, True)
        sros("view", policy, *form, "-o", named).ok()
    sros("view", policy, "--json", "-o", tmp_path / "a.picture").ok()
    sros("view", policy, "--json", "--dry-run", "-o", tmp_path / "a.svg").ok()  # JSON of the plan


def test_nothing_is_replaced_unasked_and_a_dry_run_writes_nothing(tmp_path: Path) -> None:
    policy, page = write(tmp_path, "robot.xml", "/x"), tmp_path / "page.html"
    assert "would write" in sros("view", policy, "-o", page, "--dry-run").ok().out
    assert not page.exists()
    page.write_text("mine")
    ended = sros("view", policy, "-o", page)
    assert ended.status == 2
    assert page.read_text() == "mine"
    sros("view", policy, "-o", page, "--force").ok()
    assert page.read_text() != "mine"


def test_open_shows_the_file_that_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("click.launch", opened.append)
    policy = write(tmp_path, "robot.xml", "/x")
    sros("view", policy, "-o", tmp_path / "page.html", "--open").ok()
    assert opened == [(tmp_path / "page.html").as_uri()]


@pytest.mark.parametrize("observed", [False, True])
def test_two_sources_of_one_name_are_told_apart_by_folders(tmp_path: Path, observed: bool) -> None:
    for release in ("old", "new"):
        (tmp_path / release / "p").mkdir(parents=True)
        write(tmp_path / release / "p", "x.xml", "/x")
    words = ("--observed",) if observed else ()
    ended = sros("view", tmp_path / "old/p/x.xml", *words, tmp_path / "new/p/x.xml", "--json")
    shown = json.loads(ended.ok().out)
    assert shown["title"] == "old/p/x.xml and new/p/x.xml"
    places = {finding["text"].partition(":")[0] for finding in shown["findings"]}
    assert places == {"old/p/x.xml"} | ({"new/p/x.xml"} if not observed else set())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("a.xml", "a.xml", "a.xml"), "at most two sources"),
        (("a.xml", "a.xml", "--observed", "a.xml"), "at most two sources"),
        (("a.xml", "--graphviz"), "--graphviz is for SVG only"),
        (("a.xml", "-o", "who.txt"), "view writes no .txt files"),
    ],
)
def test_what_cannot_be_meant_is_refused(
    tmp_path: Path, arguments: tuple[str, ...], said: str
) -> None:
    write(tmp_path, "a.xml", "/x")
    ended = sros("view", *arguments, cwd=tmp_path)
    assert ended.status == 2
    assert said in ended.err


@pytest.mark.parametrize("content", ["{}", '{"nodes": 3}', '{"nodes": [{}]}', "{", "<x/>", "text"])
def test_what_is_no_source_is_told_in_one_paragraph(tmp_path: Path, content: str) -> None:
    (tmp_path / "odd").write_text(content)
    ended = sros("view", tmp_path / "odd", "-o", tmp_path / "page.html")
    assert ended.status == 2
    assert "Traceback" not in ended.err and ended.err.count("\n") == 1
    assert not (tmp_path / "page.html").exists()


def test_graphviz_draws_only_where_it_is(tmp_path: Path) -> None:
    policy = write(tmp_path, "robot.xml", "/x")
    ended = sros("view", policy, "--format", "svg", "--graphviz", env={"PATH": str(tmp_path)})
    assert ended.status == 2
    assert "Graphviz is not installed" in ended.err
