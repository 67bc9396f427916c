"""``sros check --requirements`` and ``--suggest``: what is printed, and what is refused."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from sros_tool.files import templates_dir
from sros_tool.proof import findings
from tests.support.harness import copy_of, policy_text, publish, sros, subscribe, with_includes

LISTEN = '<topics subscribe="ALLOW"><topic>{}</topic></topics>'
WILD = publish("/cmd_*")
POLICY = policy_text(
    {
        "/mux": publish("/cmd_vel"),
        "/web": WILD + LISTEN.format("/scan"),
        "/wheels": LISTEN.format("/cmd_vel"),
        "/lidar": publish("/scan"),
    }
)
REQUIRED = """\
# what has to be true
[[only]]
publish = ["/cmd_vel"]
enclaves = ["/mux"]
why = "commands meet in one place"

[[apart]]
name = "the web does not drive"
from = ["/lidar"]
to = ["/wheels"]

[[must]]
enclave = "/mux"
publish = ["/cmd_vel"]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a policy, and with requirements of which two do not hold."""
    made = tmp_path_factory.mktemp("requirements")
    (made / "robot.xml").write_text(POLICY)
    (made / "required.toml").write_text(REQUIRED)
    return made


CASES = {
    "requirement.violated",
    "requirement.vacuous",
    "requirement.unknown-enclave",
    "requirement.misspelled-enclave",
    "requirement.dropped",
    "requirement.assumed",
    "requirement.unnamed",
    "requirement.not-on-zenoh",
    "requirement.of-export",
    "requirement.remapping-unused",
    "requirement.robots-left-out",
}
"""The kinds of findings that tests here bring about."""
ONLY = ("check", "robot.xml", "--include", "requirement.*")


def test_text(folder: Path) -> None:
    ended = sros(*ONLY, "--requirements", "required.toml", cwd=folder)
    assert ended.status == 1
    lines = POLICY.splitlines()
    wild = next(number for number, line in enumerate(lines, 1) if "/cmd_*" in line)
    assert ended.out.splitlines()[:6] != []
    head = f"robot.xml:{wild}: error: a requirement that does not hold [requirement.violated]"
    assert head in ended.out.splitlines()
    assert "/web: may publish /cmd_vel by /cmd_*, but only /mux may publish /cmd_vel: " in ended.out
    assert "commands meet in one place" in ended.out
    assert "/lidar -publish /scan-> /web -publish /cmd_vel by /cmd_*-> /wheels" in ended.out
    assert "required.toml:7: required: the web does not drive: /lidar must not" in ended.out
    assert "2 errors" in ended.err


def test_json_and_sarif_have_the_lines_of_both(folder: Path) -> None:
    asked = (*ONLY, "--requirements", "required.toml")
    found = json.loads(sros(*asked, "--json", cwd=folder).out)["findings"]
    assert {each["id"] for each in found} == {"requirement.violated"}
    places = [[place["file"] for place in each["related"]] for each in found]
    assert sorted(map(len, places)) == [1, 5]
    assert all(each[-1] == "required.toml" for each in places)
    (run,) = json.loads(sros(*asked, "--sarif", cwd=folder).out)["runs"]
    for result, finding in zip(run["results"], found, strict=True):
        assert len(result["relatedLocations"]) == len(finding["related"])
        for shown, related in zip(result["relatedLocations"], finding["related"], strict=True):
            place = shown["physicalLocation"]
            assert place["artifactLocation"]["uri"] == related["file"]
            assert place["region"]["startLine"] == related["line"]
            assert shown["message"]["text"] == related["text"]


def test_what_holds_and_what_cannot_fail(folder: Path, tmp_path: Path) -> None:
    held = tmp_path / "held.toml"
    held.write_text(REQUIRED.split("[[apart]]")[0].replace('"/mux"', '"/mux", "/web"'))
    sros(*ONLY, "--requirements", held, cwd=folder).ok()
    held.write_text('[[must]]\nenclave = "/none"\npublish = ["/cmd_vel"]\n')
    ended = sros(*ONLY, "--requirements", held, cwd=folder)
    assert "/none: does not exist, but /none has to be able to publish /cmd_vel" in ended.out
    held.write_text('[[only]]\npublish = ["/cmdvel"]\nenclaves = ["/mix"]\n')
    ended = sros(*ONLY, "--requirements", held, cwd=folder)
    assert ended.status == 1
    assert f"{held}:1: warning: a requirement that protects less than it states" in ended.out
    assert (
        "there is no enclave /mix (perhaps /mux is meant); required: only /mix may publish"
        in ended.out
    )
    empty = "no enclave may publish topic /cmdvel (perhaps /cmd_vel is meant)"
    assert f"{empty}; required: only /mix may publish" in ended.out
    held.write_text(held.read_text().replace("/cmdvel", "/cmd_vel"))
    ended = sros(*ONLY, "--requirements", held, cwd=folder)
    assert "[requirement.violated]" in ended.out and "[requirement.vacuous]" not in ended.out
    held.write_text('[[only]]\npublish = ["/cmd_vel"]\nenclaves = ["/mux", "/web", "/mix"]\n')
    misspelled = "requirement.misspelled-enclave"
    ended = sros(*ONLY, "--requirements", held, cwd=folder)
    assert ended.status == 1 and f"[{misspelled}]" in ended.out
    sros(*ONLY, "--requirements", held, "--exclude", misspelled, cwd=folder).ok()
    held.write_text(held.read_text().replace("/mix", "/teleop"))
    ended = sros(*ONLY, "--requirements", held, cwd=folder)
    ended.ok()
    assert f"{held}:1: note: a requirement with an exception for an enclave that" in ended.out
    assert (
        "there is no enclave /teleop; required: only /mux, /web, /teleop may publish" in ended.out
    )
    note = "requirement.unknown-enclave"
    only_note = ("check", "robot.xml", "--include", note, "--requirements", held)
    for options, shown in (
        ("--fail-on warning", True),
        ("--severity note", True),
        ("--severity warning", False),
        ("--severity error", False),
        ("--severity error --fail-on warning", False),
    ):
        for form, text in (("text", f"[{note}]"), ("json", f'"{note}"'), ("sarif", '"ruleId"')):
            ended = sros(*only_note, *options.split(), "--format", form, cwd=folder).ok()
            assert (text in ended.out) is shown, (options, form)


def test_an_action_that_is_a_service(tmp_path: Path) -> None:
    calls = '<services request="ALLOW"><service>/set</service></services>'
    (tmp_path / "p.xml").write_text(policy_text({"/a": calls}))
    held = tmp_path / "held.toml"
    held.write_text('[[only]]\ncall = ["/set"]\nenclaves = ["/a"]\n')
    ended = sros("check", "p.xml", "--requirements", held, cwd=tmp_path)
    said = "no enclave may call action /set, but some enclaves may request service /set"
    assert said in ended.out


def test_what_is_no_longer_demanded(folder: Path, tmp_path: Path) -> None:
    new, more = tmp_path / "new.toml", tmp_path / "more.toml"
    new.write_text(REQUIRED.split("[[apart]]")[0].replace('"/mux"', '"/mux", "/web"'))
    asked = (*ONLY, "--requirements", new, "--requirements-before", "required.toml")
    ended = sros(*asked, cwd=folder)
    assert ended.status == 1
    head = ": error: a requirement that was removed or weakened [requirement.dropped]"
    places = [line.removesuffix(head) for line in ended.out.splitlines() if line.endswith(head)]
    assert {*places} == {f"{new}", f"{new}:2"} and len(places) == 3
    assert (
        "    only /mux may publish /cmd_vel: the new file demands less: "
        "only /mux, /web may publish /cmd_vel\n"
        "      required.toml:2: required before\n"
    ) in ended.out
    assert (
        "    the web does not drive: /lidar must not influence /wheels: "
        "the new file has no such requirement\n      required.toml:7: required before\n"
    ) in ended.out
    more.write_text(REQUIRED)
    ended = sros(*asked, "--requirements", more, "--exclude", "requirement.violated", cwd=folder)
    assert ended.ok().out == ""
    ended = sros(*asked, "--requirements", more, cwd=folder)
    assert f"{more}:7: required: the web does not drive" in ended.out


def test_an_export_is_judged_without_the_enclaves_that_it_lacks(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(POLICY)
    (tmp_path / "required.toml").write_text(REQUIRED[: REQUIRED.index("[[apart]]")])
    for line in (
        "create_keystore ks",
        "generate_artifacts -k ks -p robot.xml",
        "distribute_key ks /mux /wheels robot",
    ):
        sros(*line.split(), cwd=tmp_path).ok()
    asked = ("--include", "requirement.*", "--requirements", "required.toml")
    assert "[requirement.violated]" in sros("check", "ks", *asked, cwd=tmp_path).out  # by /web
    ended = sros("check", "robot", *asked, cwd=tmp_path).ok()
    assert "[requirement.of-export]" in ended.out and "nothing found" not in ended.err
    assert "Check the keystore that the export comes from." in ended.out
    assert "of-export" not in sros("check", "ks", *asked, cwd=tmp_path).out
    # What only the missing enclaves would have is not found; twin: what the export breaks.
    of_others = """
[[only]]
call = ["/dock"]
enclaves = ["/planner", "/web"]
[[only]]
publish = ["/cmd_vel"]
enclaves = ["/mux", "/teleop"]
[[at_most]]
publish = ["/cmd_vel"]
enclaves = 2
[[apart]]
from = ["/planner"]
to = ["/wheels"]
[[nobody]]
publish = ["/cmd_vle"]
"""
    (tmp_path / "required.toml").write_text(of_others)
    ended = sros("check", "robot", *asked, "--severity", "note", cwd=tmp_path).ok()
    assert set(re.findall(r"\[(requirement\..*)]", ended.out)) == {"requirement.of-export"}
    (tmp_path / "required.toml").write_text(of_others.replace('"/mux", ', ""))
    ended = sros("check", "robot", *asked, cwd=tmp_path)
    assert "may publish /cmd_vel" in ended.out and "[requirement.violated]" in ended.out
    # Twin: a copy of the whole keystore, without its keys and its ledger.
    shutil.copytree(tmp_path / "ks" / "enclaves", tmp_path / "copy" / "enclaves")
    shutil.copytree(tmp_path / "ks" / "public", tmp_path / "copy" / "public")
    ended = sros("check", "copy", *asked, cwd=tmp_path)
    assert "[requirement.vacuous]" in ended.out and "of-export" not in ended.out
    # Without the router, nothing shows what Zenoh enforces, and the result says so.
    for line in ("zenoh ks", "distribute_key ks /mux /wheels peers"):
        sros(*line.split(), cwd=tmp_path).ok()
    ended = sros("check", "peers", *asked, cwd=tmp_path)
    assert ended.status == 1 and "[requirement.violated]" in ended.out
    assert "nothing was decided for Zenoh, because export 'peers' has no" in ended.out
    ended = sros("check", "peers", *asked, "--vendor", "zenoh", cwd=tmp_path)
    assert ended.status == 2 and "name a DDS vendor with --vendor" in ended.err
    ended = sros("check", "peers", *asked, "--vendor", "fastdds", cwd=tmp_path)
    assert ended.status == 1 and "not-on-zenoh" not in ended.out
    sros("distribute_key", "ks", "/router", "peers", cwd=tmp_path).ok()
    ended = sros("check", "peers", *asked, cwd=tmp_path)
    assert ended.status == 1 and "not-on-zenoh" not in ended.out
    demand = '[[must]]\nenclave = "%s"\npublish = ["/cmd_vel"]\n'
    (tmp_path / "required.toml").write_text(demand % "/web")
    ended = sros("check", "robot", *asked, cwd=tmp_path).ok()
    assert (
        "may have other enclaves, such as /web, for which requirements demand rights" in ended.out
    )
    viewed = sros("view", "robot", *asked[2:], "--json", cwd=tmp_path).ok()
    assert json.loads(viewed.out)["requirements"]["hold"] == 0
    (tmp_path / "required.toml").write_text(demand % "/gone")
    assert "/gone: does not exist" in sros("check", "ks", *asked, cwd=tmp_path).out


def test_a_policy_that_zenoh_cannot_carry_out(folder: Path, tmp_path: Path) -> None:
    """Between ``*`` and ``*`` there is no list of the names that a denial leaves."""
    policy = tmp_path / "dds.xml"
    denied = '<topics publish="DENY"><topic>/*b*c*</topic></topics>'
    policy.write_text(policy_text({"/a": publish("/*") + denied}))
    required = tmp_path / "required.toml"
    required.write_text('[[only]]\npublish = ["/x"]\nenclaves = ["/a"]\n')
    asked = ("check", policy, *ONLY[2:], "--requirements", required)
    ended = sros(*asked, "--severity", "note").ok()
    assert "[requirement.not-on-zenoh]" in ended.out
    ended = sros(*asked, "--vendor", "fastdds", "--severity", "note").ok()
    assert "[requirement.unnamed]" in ended.out
    assert "[requirement.not-on-zenoh]" not in ended.out
    ended = sros(*asked, "--vendor", "zenoh")
    assert ended.status == 2
    assert "cannot be expressed in Zenoh" in ended.err


def test_a_suggestion_holds(folder: Path, tmp_path: Path) -> None:
    suggested = tmp_path / "suggested.toml"
    suggested.write_text(sros("check", "robot.xml", "--suggest", cwd=folder).ok().out)
    text = suggested.read_text()
    assert '[[only]]\npublish = ["/scan"]\nenclaves = ["/lidar"]' in text
    assert '# topic /* has to be encrypted\n[[protected]]\ntopics = ["/*"]' in text
    assert '[[widest]]\npublish = ["/cmd_*"]' in text
    sros(*ONLY, "--requirements", suggested, cwd=folder).ok()
    changed = tmp_path / "changed.xml"
    changed.write_text(POLICY.replace("/cmd_*", "/*"))
    ended = sros("check", changed, *ONLY[2:], "--requirements", suggested)
    assert ended.status == 1
    assert ended.out.count("[requirement.violated]") == 2


def test_two_enclaves_with_a_right_are_proposed_by_name(tmp_path: Path) -> None:
    policy = tmp_path / "robot.xml"
    drives = publish("/cmd_vel")
    policy.write_text(policy_text({"/a": drives, "/b": drives, "/base": subscribe("/cmd_vel")}))
    suggested = sros("check", policy, "--suggest").ok().out
    assert '[[only]]\npublish = ["/cmd_vel"]\nenclaves = ["/a", "/b"]' in suggested
    policy.write_text(policy_text({"/a": drives}))
    (tmp_path / "look.xml").write_text(policy_text({"/look": publish("/*")}))
    suggested = sros("check", tmp_path, "--suggest").ok().out
    assert suggested.startswith(f'# Requirements that hold for "{tmp_path}" today, ')
    assert (
        "\n# not proposed: that only some enclaves may publish /cmd_vel (stated for 1 enclave, "
        in suggested
    )


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("runtime", "--requirements", "required.toml"), "takes one keystore, or the policies"),
        (("robot.xml", "--requirements", "gone.toml"), "gone.toml"),
        (("robot.xml", "--requirements", "robot.xml"), "not valid TOML"),
        (("required.toml", "--requirements", "required.toml"), "required.toml"),
        (("robot.xml", "--requirements-before", "required.toml"), "needs --requirements"),
        (("runtime", "--template", "production"), "--template is for policies that are not"),
        (("signed", "--template", "production"), "--template is for policies that are not"),
        (("robot.xml", "--suggest", "--json"), "--suggest prints TOML"),
        (("robot.xml", "--suggest", "--requirements", "required.toml"), "--suggest prints TOML"),
    ],
)
def test_what_is_refused(words: tuple[str, ...], says: str, folder: Path) -> None:
    (folder / "signed").mkdir(exist_ok=True)  # the folder of an enclave
    (folder / "signed/permissions.p7s").touch()
    ended = sros("check", *words, cwd=folder)
    assert ended.status == 2
    assert says in ended.err
    assert "defect" not in ended.err


def test_a_policy_and_its_keystore_both_have_to_fulfill_requirements(
    folder: Path, tmp_path: Path
) -> None:
    """As after an edit that is not signed yet; what each lacks by itself is a finding."""
    (policy := tmp_path / "robot.xml").write_text(POLICY.replace(WILD, ""))
    keystore, words = tmp_path / "keystore", (*ONLY[2:], "--requirements", "required.toml")
    sros("create_keystore", keystore).ok()
    sros("generate_artifacts", "-k", keystore, "-p", policy).ok()
    alone = [sros("check", path, *words, cwd=folder) for path in (policy, keystore, "robot.xml")]
    assert [ended.status for ended in alone] == [0, 0, 1]
    for edited, status in ((policy, 0), (folder / "robot.xml", 1)):
        ended = sros("check", edited, keystore, *words, cwd=folder)
        assert ended.status == status and ("/web: may publish" in ended.out) is bool(status)
    sros("generate_artifacts", "-k", keystore, "-p", folder / "robot.xml").ok()
    ended = sros("check", policy, keystore, *words, cwd=folder)
    assert ended.status == 1 and "/web: may publish /cmd_vel" in ended.out
    for more in (("--suggest",), (keystore, *words)):
        ended = sros("check", policy, keystore, *more, cwd=folder)
        assert ended.status == 2 and "takes one keystore, or the policies" in ended.err


def test_several_policies_of_a_robot_count_as_one(folder: Path, tmp_path: Path) -> None:
    """A name has its other side, and a requirement is broken, in the other file."""
    shutil.copy(folder / "required.toml", tmp_path)
    base, more = tmp_path / "p/base.xml", tmp_path / "p/more.xml"
    base.parent.mkdir()
    base.write_text(policy_text({"/wheels": LISTEN.format("/cmd_vel"), "/lidar": publish("/s")}))
    more.write_text(policy_text({"/mux": publish("/cmd_vel"), "/web": publish("/cmd_vel")}))
    alone = sros("check", base, "--severity", "note").out
    assert "no enclave may publish /cmd_vel" in alone
    words = ("--severity", "note", "--requirements", "required.toml")
    found = sros("check", "p", *words, cwd=tmp_path)
    assert found.status == 1 and "no enclave may publish" not in found.out, found
    assert "/web: may publish /cmd_vel, but only /mux may publish /cmd_vel" in found.out
    shutil.copy(base, more)
    twice = sros("check", base, more, *words, cwd=tmp_path)
    assert (twice.status, "is in another policy, too" in twice.err) == (2, True)
    # Two enclaves of one name can be in one line of a file that both policies include.
    parts = [policy_text({"/mux": publish(name)}) for name in ("/safe", "/cmd_vel")]
    enclaves = (re.sub(r"(?s).*(<enclave .*</enclave>).*", r"\1", part) for part in parts)
    (base.parent / "part.xml").write_text("<x><a>{}</a><b>{}</b></x>".format(*enclaves))
    for part, file in (("a", base), ("b", more)):
        include = f'<xi:include href="part.xml" xpointer="xpointer(/x/{part}/enclave)"/>'
        text = policy_text({f"/{part}": publish("/s")}).replace(
            "<enclaves>", f"<enclaves>{include}"
        )
        file.write_text(with_includes(text))
    for both in (words, ("--requirements", "required.toml", "--json")):
        hidden = sros("check", "p", *both, cwd=tmp_path)
        assert (hidden.status, "enclave /mux is in another policy" in hidden.err) == (2, True), (
            hidden
        )


def test_more_wildcards_than_can_be_decided_are_one_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each ``?`` after a star doubles what has to be told apart."""
    monkeypatch.setattr(findings, "MOST_STEPS", 5000)
    policy, required = tmp_path / "hard.xml", tmp_path / "hard.toml"
    policy.write_text(policy_text({"/e": publish("/*a" + "?" * 200)}))
    required.write_text(f'[[widest]]\npublish = ["/*a*{"?" * 180}"]\nenclaves = ["*"]\n')
    ended = sros("check", policy, "--requirements", required)
    assert ended.status == 2
    assert "there are too many wildcards to decide which names they match" in ended.err


@pytest.fixture(scope="module")
def keystore(folder: Path) -> Path:
    """A keystore of the policy, with its Zenoh configurations; only to be read."""
    sros("generate_artifacts", "-k", "ks", "-p", "robot.xml", cwd=folder).ok()
    sros("zenoh", "ks", cwd=folder).ok()
    return folder / "ks"


def test_a_keystore_is_decided_as_it_is_signed(keystore: Path, tmp_path: Path) -> None:
    asked = ("check", "ks", *ONLY[2:], "--requirements")
    folder = keystore.parent
    ended = sros(*asked, "required.toml", cwd=folder)
    assert ended.status == 1
    assert "ks/enclaves/web/permissions.p7s: error: a requirement that does not" in ended.out
    assert "/web: may publish /cmd_vel by /cmd_*, but only /mux may publish /cmd_vel: " in ended.out
    assert "/lidar -publish /scan-> /web -publish /cmd_vel by /cmd_*-> /wheels" in ended.out
    assert "2 errors" in ended.err
    assert "only:" not in ended.out
    zenoh = sros(*asked, "required.toml", "--vendor", "zenoh", cwd=folder)
    assert zenoh.out == ended.out
    # What has expired lets nobody do anything.
    (tmp_path / "must.toml").write_text('[[must]]\nenclave = "/mux"\npublish = ["/cmd_vel"]\n')
    sros(*asked, tmp_path / "must.toml", cwd=folder).ok()
    late = ("--at", "2099-01-01", "--vendor", "fastdds")
    ended = sros(*asked, tmp_path / "must.toml", *late, cwd=folder)
    assert ended.status == 1
    assert "/mux: cannot start with its current files (`sros check` shows why)" in ended.out
    # Of the public part of a keystore, the keys are elsewhere; of this one, a key is gone.
    copied = tmp_path / "public"
    copy_of(keystore, copied)
    (copied / "enclaves" / "mux" / "key.pem").unlink()
    again = ("check", copied, *ONLY[2:], "--requirements", tmp_path / "must.toml")
    ended = sros(*again)
    assert (ended.status, "/mux: cannot start with its current files" in ended.out) == (1, True)
    for key in copied.glob("enclaves/*/key.pem"):
        key.unlink()
    sros(*again).ok()
    (tmp_path / "must.toml").write_text('[[must]]\nenclave = "/mux"\npublish = ["/scan"]\n')
    assert "/mux: may not publish /scan, but" in sros(*again).out


def test_a_keystore_gives_proposals_that_hold(keystore: Path, tmp_path: Path) -> None:
    suggested = tmp_path / "suggested.toml"
    suggested.write_text(sros("check", keystore, "--suggest").ok().out)
    assert '[[only]]\npublish = ["/scan"]\nenclaves = ["/lidar"]' in suggested.read_text()
    sros("check", keystore, *ONLY[2:], "--requirements", suggested).ok()


def test_an_assumed_template_is_said(folder: Path, keystore: Path, tmp_path: Path) -> None:
    required = tmp_path / "protected.toml"
    required.write_text('[[protected]]\ntopics = ["/scan"]\nlevel = "encrypt"\n')
    asked = (*ONLY, "--requirements", required)
    said = sros(*asked, cwd=folder).ok().out
    assert "note: a protection that the policy does not state [requirement.assumed]" in said
    assert 'write <?sros protect="..."?> directly after the name in the policy, before its' in said
    assert (
        "topic /scan has to be encrypted: the policy does not say how /scan is protected; sros "
        "assumes the template development\n"
    ) in said
    assert sros(*asked, "--template", "production", cwd=folder).ok().out == ""
    weak = tmp_path / "weak.toml"
    weak.write_text((templates_dir() / "production.toml").read_text().replace("ENCRYPT", "SIGN"))
    ended = sros(*asked, "--template", weak, cwd=folder)
    assert ended.status == 1
    assert "/scan: its messages are not encrypted, but topic /scan has to be encrypted" in ended.out
    demanded = tmp_path / "robot.xml"
    demanded.write_text(POLICY.replace("/scan<", '/scan<?sros protect="sign"?><'))
    assert sros("check", demanded, *asked[2:], cwd=folder).status == 1
    ended = sros("check", keystore, *asked[2:], "--template", "production")
    assert (ended.status, "has its own governance" in ended.err) == (2, True)


def test_a_requirement_of_protection_is_about_the_governance(folder: Path, tmp_path: Path) -> None:
    required = tmp_path / "protected.toml"
    required.write_text('[[protected]]\ntopics = ["/scan"]\nlevel = "encrypt"\n')
    sros("generate_artifacts", "-k", tmp_path / "ks", "-p", folder / "robot.xml").ok()
    asked = ("check", tmp_path / "ks", *ONLY[2:], "--requirements", required)
    sros(*asked).ok()
    weak = [f"protection.{each}" for each in ("default.data=SIGN", "default.metadata=NONE")]
    for each in weak:
        sros("update_keystore", tmp_path / "ks", "--set", each, "--allow-looser").ok()
    ended = sros(*asked)
    assert ended.status == 1
    assert "/scan: its messages are not encrypted, but topic /scan has to be encrypted" in ended.out
    required.write_text(required.read_text().replace("encrypt", "sign"))
    sros(*asked).ok()


def test_a_wildcard_namespace_counts_in_every_world(tmp_path: Path) -> None:
    """Taken for rights to DDS topics, they were missing on Zenoh, where they were given."""
    policy, before = tmp_path / "wild.xml", tmp_path / "before.xml"
    rights = {
        "/a": '<services request="ALLOW"><service>x</service></services>'
        '<actions call="ALLOW"><action>d</action></actions>',
        "/b": '<services reply="ALLOW"><service>/n/x</service></services>',
    }
    policy.write_text(policy_text(rights).replace('ns="/"', 'ns="*"', 1))
    before.write_text(policy_text(rights | {"/a": publish("x")}))
    required = tmp_path / "required.toml"
    required.write_text('[[nobody]]\nrequest = ["/n/x"]\n[[nobody]]\ncall = ["/n/d"]\n')
    for vendor in ((), ("--vendor", "zenoh")):
        ended = sros("check", policy, *ONLY[2:], "--requirements", required, *vendor)
        assert ended.status == 1
        assert "/a: may request /n/x by /*/x, but nobody may request /n/x\n" in ended.out
        assert "/a: may call action /n/d by /*/d, but nobody may call action /n/d\n" in ended.out
    ended = sros("diff_policy", "--no-new-access", before, policy)
    assert ended.status == 1
    assert "/a" in ended.out
    assert "/n/x" in sros("explain", policy, "--reach", "/a").out
    sros("view", policy, "--focus", "/a", "-o", tmp_path / "focus.svg").ok()


def test_nothing_is_decided_that_depends_on_a_file_that_is_absent(tmp_path: Path) -> None:
    """The robot has the file: what it adds was in no comparison, and broke no requirement."""
    policy, before = tmp_path / "robot.xml", tmp_path / "before.xml"
    required = tmp_path / "required.toml"
    before.write_text(policy_text({"/a": publish("/x")}))
    include = (
        '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="site.xml" '
        'xpointer="xpointer(/profile/*)">\n<xi:fallback/></xi:include>'
    )
    policy.write_text(policy_text({"/a": publish("/x") + include}))
    required.write_text('[[nobody]]\npublish = ["/cmd_vel"]\n')
    compared = ("diff_policy", "--no-new-access", before, policy)
    decided = ("check", policy, "--requirements", required, "--include", "requirement.violated")
    for asked in (compared, decided):
        ended = sros(*asked)
        assert ended.status == 2
        line = policy.read_text().split("<xi:include")[0].count("\n") + 1
        assert f"{policy}:{line}: the fallback of the include is used, because" in ended.err
        assert "the policy may give other rights" in ended.err
    assert sros("diff_policy", "--no-new-access", policy, before).status == 2
    (tmp_path / "site.xml").write_text(f"<profile ns='/' node='n'>{publish('/cmd_vel')}</profile>")
    assert [sros(*asked).status for asked in (compared, decided)] == [1, 1]


def test_a_template_mends_names_that_it_makes_unique(tmp_path: Path) -> None:
    """Cyclone DDS mistakes ``/arm`` for ``/left/arm`` unless their subjects are unique."""
    names = policy_text({"/arm": publish("/x"), "/left/arm": publish("/y")})
    (tmp_path / "robot.xml").write_text(names)
    (tmp_path / "required.toml").write_text('[[nobody]]\npublish = ["/z"]\n')
    asked = ("check", "robot.xml", "--requirements", "required.toml")
    found = {
        template: "[portable.enclave-names]"
        in sros(*asked, "--template", template, cwd=tmp_path).out
        for template in ("development", "production")
    }
    assert found == {"development": True, "production": False}
    assert "[portable.enclave-names]" in sros("check", "robot.xml", cwd=tmp_path).out
    ended = sros("check", "robot.xml", "--template", "production", cwd=tmp_path)
    assert "policy.no-rosout" in ended.out and "portable.enclave-names" not in ended.out
    for template in found:
        sros("create_keystore", tmp_path / template, "--template", template).ok()
        made = sros("create_enclave", tmp_path / template, "/arm", "/left/arm").ok()
        assert ("Cyclone DDS 0.10 mistakes /arm" in made.err) == found[template]


def test_a_robot_in_no_namespace_that_was_named_is_told(tmp_path: Path) -> None:
    robots = policy_text({"/{robot}/mux": publish("cmd_vel")}).replace('ns="/"', 'ns="{namespace}"')
    (tmp_path / "p.xml").write_text(robots)
    (tmp_path / "fleet.toml").write_text(
        '[robots]\nred = {}\nreddish = {}\nblue = { namespace = "/hall/blue" }\n'
    )
    (tmp_path / "r.toml").write_text('[[only]]\npublish = ["cmd_vel"]\nenclaves = ["/mux"]\n')
    asked = ("check", "p.xml", "--fleet", "fleet.toml", "--requirements", "r.toml")
    ended = sros(*asked, "--namespace", "/red", cwd=tmp_path)
    assert "not checked for robots outside the named namespaces: blue, reddish" in ended.out
    every = ("/red/left", "/reddish", "/hall/blue")
    named = [word for namespace in every for word in ("--namespace", namespace)]
    assert "robots-left-out" not in sros(*asked, *named, cwd=tmp_path).out


def test_requirements_of_a_package_in_two_namespaces(tmp_path: Path) -> None:
    rights = {f"/{side}/mux": publish(f"/{side}/cmd") for side in ("left", "right")}
    rights["/base"] = subscribe("/left/cmd", "/right/cmd")
    (tmp_path / "p.xml").write_text(policy_text(rights | {"/right/evil": publish("/right/cmd")}))
    (tmp_path / "r.toml").write_text('[[only]]\npublish = ["cmd"]\nenclaves = ["/mux"]\n')
    asked = ("check", "p.xml", *ONLY[2:], "--requirements", "r.toml")
    ended = sros(*asked, "--namespace", "/left", cwd=tmp_path).ok()
    assert ended.out == ""
    ended = sros(*asked, "--namespace", "/left", "--namespace", "/right", cwd=tmp_path)
    assert ended.status == 1 and ended.out.count("but only /right/mux may publish /right/cmd") == 1
    (tmp_path / "p.xml").write_text(policy_text(rights | {"/mission": publish("/left/cmd")}))
    ended = sros(*asked, "--namespace", "/left", cwd=tmp_path)
    assert (
        'add "//mission" to `enclaves` of the requirement at r.toml:1; if a package ships the '
        "file, write this only into a copy." in ended.out
    )
    (tmp_path / "p.xml").write_text(policy_text(rights | {"/left/ui": publish("/left/cmd")}))
    ended = sros(*asked, "--namespace", "/left", cwd=tmp_path)
    assert (
        'add "/ui" to `enclaves` of the requirement at r.toml:1; there, a name with one / at its '
        "beginning is below /left." in ended.out
    )
    (tmp_path / "ui.toml").write_text('[[only]]\npublish = ["cmd"]\nenclaves = ["/mux", "//ui*"]\n')
    ended = sros(*asked[:-1], "ui.toml", "--namespace", "/left", cwd=tmp_path)
    said = (
        "To keep /ui out of /left, as the requirement says, merge its policy with `--enclave /ui`."
    )
    assert said in ended.out and "to allow this" not in ended.out
    (tmp_path / "less.toml").write_text('[[must]]\npublish = ["cmd"]\nenclave = "/mux"\n')
    less = ("check", "p.xml", *ONLY[2:], "--requirements", "less.toml")
    both = ("--requirements-before", "r.toml", "--namespace", "/left", "--namespace", "/right")
    ended = sros(*less, *both, cwd=tmp_path)
    for side in ("left", "right"):
        dropped = (
            f"only /{side}/mux may publish /{side}/cmd: the new file has no such requirement "
            f"(if nobody is to publish /{side}/cmd any more, write so in [[nobody]])"
        )
        assert f"{dropped}\n" in ended.out
    assert sros(*asked, "--namespace", "/r*", cwd=tmp_path).status == 2
    assert sros("check", "p.xml", "--namespace", "/left", cwd=tmp_path).status == 2


def test_requirements_are_remapped_as_the_policy(tmp_path: Path) -> None:
    """A requirement on the old name would hold, whoever may request the new one."""
    served = '<services reply="ALLOW"><service>~/close</service></services>'
    asks = '<services request="ALLOW"><service>{}</service></services>'
    gripper = policy_text({"/gripper": served}).replace('node="n"', 'node="gripper"')
    (tmp_path / "gripper.xml").write_text(gripper)
    (tmp_path / "own.xml").write_text(
        policy_text(
            {"/left/planner": asks.format("/left/gripper/close"), "/base": asks.format("/g")}
        )
    )
    (tmp_path / "r.toml").write_text(
        '[[only]]\nrequest = ["gripper/close"]\nenclaves = ["/planner"]\n'
    )
    places, rule = ("--namespace", "/left"), ("--remap", "gripper:~/close:=/g")
    merge = ("merge_policy", "own.xml", "gripper.xml", *places, *rule, "-o", "robot.xml")
    said = "`sros check POLICY --requirements FILE --remap 'gripper:~/close:=/g'`"
    assert said in sros(*merge, cwd=tmp_path).ok().err
    asked = ("check", "robot.xml", *ONLY[2:], "--requirements", "r.toml", *places)
    ended = sros(*asked, cwd=tmp_path)
    assert ended.status == 1
    assert "no enclave may serve service /left/gripper/close; required: only" in ended.out
    ended = sros(*asked, *rule, cwd=tmp_path)
    assert ended.status == 1
    assert "/base: may request /g, but only /left/planner may request /g" in ended.out
    for words, problem in (
        (("--remap", "close:=/h"), "--remap close:=/h: no requirement has the old name"),
        (("--remap", "~/close:=/g"), "Write it as NODE:~/close:=/g."),
        (("--remap", "close:=~/g"), "Write it as NODE:close:=~/g."),
        (("--remap", "__node:=x"), "Write it as NODE:__node:=x."),
        (("--remap", "__ns:=/x"), "policy with --namespace /x in place of this rule"),
        (("--remap", "a:close:=/g"), "Other nodes than a may keep the name."),
    ):
        ended = sros(*asked, *words, cwd=tmp_path)
        assert (ended.status, problem in ended.err) == (2, True), ended
    assert sros("check", "robot.xml", *rule, cwd=tmp_path).status == 2


def test_what_merging_prints_runs_where_no_requirement_names_the_node(tmp_path: Path) -> None:
    """Without a note, unless a requirement has a similar name, or another rule moves the name.

    A rule whose new name the policy does not have, either, is misspelled.
    """
    nodes = policy_text(
        {
            "/a": '<topics publish="ALLOW"><topic>range</topic></topics>'
            '<services reply="ALLOW"><service>~/reset</service></services>',
        }
    ).replace('node="n"', 'node="mapper"')
    (tmp_path / "own.xml").write_text(policy_text({"/b": publish("/x")}))
    (tmp_path / "mapper.xml").write_text(nodes)
    (tmp_path / "r.toml").write_text('[[only]]\npublish = ["range"]\nenclaves = ["/a"]\n')
    rules = ("--remap", "__node:=sonar_map", "--remap", "range:=distance")
    merged = sros("merge_policy", "own.xml", "mapper.xml", *rules, "-o", "p.xml", cwd=tmp_path)
    (printed,) = re.findall(r"`sros (check [^`]+)`", merged.ok().err)
    command = printed.replace("POLICY", "p.xml").replace("FILE", "r.toml").split()
    asked = (*command, "--include", "requirement.*")
    ended = sros(*asked, cwd=tmp_path).ok()
    assert "remapping-unused" not in ended.out, ended
    (tmp_path / "r.toml").write_text('[[only]]\npublish = ["rnge"]\nenclaves = ["/a"]\n')
    misspelled = sros(*asked, cwd=tmp_path).out
    assert "--remap range:=distance: no requirement has the old name" in misspelled
    assert misspelled.count("remapping-unused") == 1, misspelled
    (tmp_path / "r.toml").write_text('[[only]]\nrequest = ["mapper/reset"]\nenclaves = ["/a"]\n')
    for new, noted in (("sonar_map/reset", 0), ("distance", 1)):
        twice = (f"mapper/reset:={new}", "mapper:__node:=sonar_map")
        words = [word for rule in twice for word in ("--remap", rule)]
        ended = sros(*command[: command.index("--remap")], *words, *asked[-2:], cwd=tmp_path).ok()
        assert ended.out.count("[requirement.remapping-unused]") == noted, ended
        of_other = f"--remap {twice[0]}: no requirement has the old name, or another"
        assert (of_other in ended.out) is bool(noted)
    for misspelled in ("mapper:__node:=sonar_mop", "mapper:~/reset:=~/rest", "rnge:=distanc"):
        ended = sros(*asked, "--remap", misspelled, cwd=tmp_path)
        said = f"{misspelled}: no requirement has the old name, and 'p.xml' does not have the new"
        assert (ended.status, said in ended.err) == (2, True), ended
